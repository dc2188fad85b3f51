"""The commands of `cmig`, one module each: `parse` turns arguments into a command, `run` runs it and returns the exit code."""


class Stopped(Exception):
    """A command was interrupted; the message says how it continues."""


class Failed(Exception):
    """A command ended early because a check failed."""
