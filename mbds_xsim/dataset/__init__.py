"""Making, checking, publishing and reading data sets."""
