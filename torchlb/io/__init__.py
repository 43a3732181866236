"""Shapes and operators on disk.

`files`: meshes and clouds from files and to files. `formats`: file formats that are read here. `cache`: operators,
stored under a hash of their input. `precompute`: the operators of a data set, in parallel.
"""
