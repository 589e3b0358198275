"""`fognav bench`: measurements that run from a fresh clone. They are no tests: no figure makes them fail."""
