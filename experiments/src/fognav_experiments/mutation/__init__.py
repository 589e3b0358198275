"""Mutation tests: whether the tests of a part notice each small change of its code."""
