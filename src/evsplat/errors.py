"""The exceptions that a user may meet; each message is one sentence that says what to do."""


class EvsplatError(Exception):
    """The input's or the machine's fault; the command line prints it and exits with 2."""


class DataError(EvsplatError):
    """A capture, event file or run folder is not what it should be."""


class HeldOutError(EvsplatError):
    """A training asked for what its policy hides from it."""


class ConfigError(EvsplatError):
    """A configuration value or option is unknown or out of range."""


class WeightsError(EvsplatError):
    """Weights of a pretrained network are missing or do not fit."""


class BackendError(EvsplatError):
    """A backend or device that was asked for cannot run here."""
