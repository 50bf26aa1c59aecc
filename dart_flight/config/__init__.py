"""Conversion of YAML files to typed, validated, immutable objects.

Functions that read or write a file named by the operator raise `InputError`, which names the file, line and
key.
"""
