"""The one kind of error a user can mend."""


class UsageError(Exception):
    """One line that names the file, row or column at fault and says the mend.

    The command line prints it without a traceback and exits with code 2.
    """
