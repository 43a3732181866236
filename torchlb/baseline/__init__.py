"""The low-order peer as strong-form rows, analyst's sign; the only import of its library.

`cotangent`: libigl's cotangent operator.
"""
