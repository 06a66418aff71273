"""Hostile variants of everything that the library takes: `python -m tests.fuzz --cases N --seed S` tries them.

Modules:
    arguments: cases of arguments of public functions
    campaign: runs cases one after the other, judges them, keeps the verdicts
    cases: what a case is, and the verdict about it
    commands: cases of command lines
    damage: damage to bytes, arrays and paths
    files: cases of files
    fields: cases of clouds, demonstrations and poses that a network computes with
    undamaged: the files and objects that are damaged, and what they mean
"""
