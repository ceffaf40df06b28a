"""The one family of exceptions for what the user can mend."""


class UserError(Exception):
    """Wrong use or unusable input: the message is one sentence naming the thing and the change.

    The command line turns it into exit status 2; bad data *in a stream* never raises it.
    """
