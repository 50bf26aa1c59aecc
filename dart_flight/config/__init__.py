"""Conversion of YAML files to typed, validated, immutable objects; every error names file, line and key."""
