"""The version of the package: it names the release, and is part of the key of every cached operator."""

__version__ = "0.3.0"
