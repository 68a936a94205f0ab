"""What the user can mend: a base for the errors that get one line instead of a traceback."""


class Refusal(Exception):
    """Something cannot be done as it was asked for; the message says what and why, in one line."""
