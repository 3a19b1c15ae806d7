"""Refuse addresses that contain credentials, so that none gets into a file, a store or a message."""

from __future__ import annotations

import re

from tacpipe.errors import UsageError

_USER = re.compile(r"(?<!/)(//)[^/?#\s\"']*@")  # a user name, with or without a password, before a host
_OPTION = re.compile(r"[?&](pass|passwd|password|pwd|secret|(access_|auth_?)?token|api_?key)=", re.IGNORECASE)


def refuse_credentials(text: str, source: str) -> None:
    """Raise `UsageError` if an address in ``text`` contains credentials. The error names ``source`` and not the text.

    >>> refuse_credentials("mjpeg:http://192.168.1.20:8080/?action=stream", "rig.toml")
    """
    if _USER.search(text) or _OPTION.search(text):
        raise UsageError(
            f"{source} has an address that contains a user name, a password or a token. Remove them from the address, "
            f"because it is stored with the results. Give them in ~/.netrc for a camera, and in the variables of the "
            f"environment that a tracker or a store reads."
        )


def without_credentials(address: str) -> str:
    """Return an address without the user name and password before its host.

    >>> without_credentials("postgresql://lee:secret@lab/runs"), without_credentials("sqlite:///mlflow.db")
    ('postgresql://lab/runs', 'sqlite:///mlflow.db')
    """
    return _USER.sub(r"\1", address)
