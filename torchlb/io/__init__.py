"""Shapes and operators on disk.

`files`: meshes and clouds from files. `formats`: those that are read here. `cache`: operators, found by what they were
computed from. `precompute`: a data set at once, in parallel.
"""
