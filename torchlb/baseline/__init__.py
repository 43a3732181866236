"""The low-order peer, libigl's `cotangent` operator, as strong-form rows; the only import of its library."""
