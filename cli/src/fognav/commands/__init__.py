"""The command line: one module for each command, which reads its options and says what came of it."""
