"""``evsplat settings``: what can be set of a method."""

from typing import Annotated

from evsplat.cli.options import option


def settings(*, method: Annotated[str | None, option("NAME", default="evsplat")] = None) -> None:
    """Print every setting of a method with its meaning, range and default.

    What is printed is a configuration: changed, it goes to 'evsplat train CAPTURE --config FILE'.

    Args:
        method: Name of the method.
    """
    from evsplat.config_docs import explained_yaml
    from evsplat.methods import DEFAULT_METHOD, method_config

    method = method or DEFAULT_METHOD
    print(explained_yaml(method_config(method, {}, where="defaults"), method=method), end="")
