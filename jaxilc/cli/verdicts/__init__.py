"""Verdicts of the commands, in sentences, each with the next command to type."""
