"""Addresses of stores in object storage, and the settings that the usual environment and profiles have for them.

Credentials go from here into the client alone. An address that carries one is refused, so none can get into a record.
"""

from __future__ import annotations

import configparser
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tacpipe.errors import UsageError
from tacpipe.plugins import extras

SCHEMES = {
    "s3": "Amazon S3 and servers that speak its protocol",
    "gs": "Google Cloud Storage",
    "az": "Azure Blob Storage",
}
_ADDRESS = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://(.*)", re.DOTALL)
_PARTS = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*(/[A-Za-z0-9._ =+,-]+)*")  # a bucket, and folders in it
_OWN = (  # where one of these is set, the client finds its credentials itself
    "AWS_ACCESS_KEY_ID",
    "AWS_WEB_IDENTITY_TOKEN_FILE",
    "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI",
    "AWS_CONTAINER_CREDENTIALS_FULL_URI",
)
_STATED = {  # settings of a profile, and what the client calls them
    "aws_access_key_id": "access_key_id",
    "aws_secret_access_key": "secret_access_key",
    "aws_session_token": "session_token",
}
_PLAIN = {"region": "region", "endpoint_url": "endpoint"}


@dataclass(frozen=True)
class Address:
    """Where a store lies in object storage."""

    scheme: str
    path: str  # bucket/folder/…

    def __str__(self) -> str:
        """Return the address as a command takes it."""
        return f"{self.scheme}://{self.path}"


@dataclass
class Settings:
    """What the client is given besides the address; its representation shows no credential."""

    config: dict[str, Any] = field(default_factory=dict, repr=False)
    provider: Any = field(default=None, repr=False)  # of credentials that change, as those of roles do
    plaintext: bool = False  # the server is reached without TLS
    url: str = ""  # what the client is given in place of the address


def parsed(text: str) -> Address | Path:
    """Return the address that ``text`` gives, or a path; ``file:///lab/store`` is a path too.

    Raises `UsageError` for an address of another kind, and for one with credentials or options in it.

    >>> parsed("/lab/store"), parsed("file:///lab/store"), str(parsed("s3://lab/store/"))
    (PosixPath('/lab/store'), PosixPath('/lab/store'), 's3://lab/store')
    """
    found = _ADDRESS.fullmatch(text)
    if found is None:
        return Path(text)
    scheme, rest = found[1].lower(), found[2]
    if scheme == "file":
        if not rest.startswith("/"):
            raise UsageError(f"{scheme}:// is followed by a path from the top, as in file:///lab/store.")
        return Path(rest)
    if scheme not in SCHEMES:
        known = ", ".join(f"{one}://" for one in SCHEMES)
        raise UsageError(
            f"An address that begins with {scheme}:// is not supported. Give one that begins with {known} or file://, or a "
            f"path of the file system."
        )
    path = rest.rstrip("/")
    if not _PARTS.fullmatch(path) or ".." in path.split("/"):  # not shown: it may hold a password
        raise UsageError(
            f"An address of a store is {scheme}://BUCKET/FOLDER, of letters, digits and ._=+,- alone. Credentials belong in "
            f"the environment or in a profile, never in an address."
        )
    if scheme == "az" and "/" not in path:
        raise UsageError(f"{scheme}://{path} names no container. Give az://ACCOUNT/CONTAINER/FOLDER.")
    return Address(scheme, path)


def settings(address: Address, environment: Mapping[str, str] = os.environ) -> Settings:
    """Return what the environment does not give the client by itself: settings of a profile, and whether TLS is used.

    Raises `UsageError` for a profile that is named and is not there.
    """
    if address.scheme == "az":  # the client takes the account as a setting
        account, _, within = address.path.partition("/")
        return Settings({"account_name": account}, url=f"az://{within}")
    if address.scheme != "s3":
        return Settings()
    found = Settings({"disable_bulk_delete": True})  # which not every server knows, and one at a time is deleted here
    named = environment.get("AWS_PROFILE") or environment.get("AWS_DEFAULT_PROFILE") or ""
    if named or not any(environment.get(name) for name in _OWN):
        _fill(found, named, environment)
    endpoints = (environment.get(name) for name in ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"))
    endpoint = next((one for one in endpoints if one), found.config.get("endpoint", ""))
    if endpoint:
        found.config["endpoint"] = endpoint
    found.plaintext = endpoint.startswith("http://")
    return found


def _fill(found: Settings, named: str, environment: Mapping[str, str]) -> None:
    """Add what the profile has; credentials of the environment come first, as they do for others."""
    home = Path(environment.get("HOME") or "~").expanduser() / ".aws"
    files = [
        (environment.get("AWS_CONFIG_FILE") or home / "config", "profile "),
        (environment.get("AWS_SHARED_CREDENTIALS_FILE") or home / "credentials", ""),
    ]
    name, there = named or "default", False
    profile: dict[str, str] = {}
    for path, before in files:
        reader = configparser.RawConfigParser()
        try:
            reader.read(path, encoding="utf-8")
        except (configparser.Error, UnicodeDecodeError):  # what it states would show a credential
            raise UsageError(f"{path} is not a file of profiles: a line of it cannot be read.") from None
        for section in (name, f"{before}{name}"):
            if reader.has_section(section):
                there = True
                profile.update(reader.items(section))
    if named and not there:
        raise UsageError(f"There is no profile {named} in {files[1][0]} or {files[0][0]}; AWS_PROFILE names it.")
    found.config.update({new: profile[old] for old, new in _PLAIN.items() if profile.get(old)})
    region = environment.get("AWS_REGION") or environment.get("AWS_DEFAULT_REGION")
    if region:
        found.config["region"] = region
    if any(environment.get(one) for one in _OWN):
        return
    if profile.get("aws_secret_access_key"):
        found.config.update({new: profile[old] for old, new in _STATED.items() if profile.get(old)})
    elif there and any(one.startswith(("sso_", "role_arn", "credential_process", "source_profile")) for one in profile):
        found.provider = _provider(name)


def _provider(name: str) -> Any:
    """Return what asks boto3 for the credentials of a profile that states none itself: a role, or a single sign-on."""
    with extras.named(f"The profile {name}, whose credentials are those of a role or a sign-on,"):
        from boto3 import Session
        from obstore.auth.boto3 import Boto3CredentialProvider
    return Boto3CredentialProvider(Session(profile_name=name))
