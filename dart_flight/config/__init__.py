"""YAML files in, typed, validated, frozen objects out; every error names file, line and key."""
