"""Addresses of stores in object storage, and their settings from the environment and profiles.

Credentials are passed only to the client. An address that contains one is rejected, so none can get into a record.
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
_PARTS = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*(/[A-Za-z0-9._ =+,-]+)*")  # a bucket and folders in it
_OWN = (  # if one of these is set, the client finds its credentials itself
    "AWS_ACCESS_KEY_ID",
    "AWS_WEB_IDENTITY_TOKEN_FILE",
    "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI",
    "AWS_CONTAINER_CREDENTIALS_FULL_URI",
)
_STATED = {  # name in the client by setting of a profile
    "aws_access_key_id": "access_key_id",
    "aws_secret_access_key": "secret_access_key",
    "aws_session_token": "session_token",
}
_PLAIN = {"region": "region", "endpoint_url": "endpoint"}


@dataclass(frozen=True)
class BucketAddress:
    """Address of a store in object storage."""

    scheme: str
    path: str  # bucket/folder/…

    def __str__(self) -> str:
        """Return the address as used on the command line."""
        return f"{self.scheme}://{self.path}"


@dataclass
class ClientSettings:
    """Settings of the client besides the address. Their representation contains no credentials."""

    config: dict[str, str | bool] = field(default_factory=dict, repr=False)
    # provides credentials that change, such as the temporary ones of a role
    provider: Any = field(default=None, repr=False)
    plaintext: bool = False  # whether the server is accessed without TLS
    url: str = ""  # replaces the address unless it is empty


def parse_address(text: str) -> BucketAddress | Path:
    """Parse an address or a path; ``file:///lab/store`` is a path too.

    Raises `UsageError` for an unsupported scheme, and for an address with credentials or options.

    >>> parse_address("/lab/store"), parse_address("file:///lab/store"), str(parse_address("s3://lab/store/"))
    (PosixPath('/lab/store'), PosixPath('/lab/store'), 's3://lab/store')
    """
    match = _ADDRESS.fullmatch(text)
    if match is None:
        return Path(text)
    scheme, location = match[1].lower(), match[2]
    if scheme == "file":
        if not location.startswith("/"):
            raise UsageError(f"{scheme}:// is followed by a path from the top, as in file:///lab/store.")
        return Path(location)
    if scheme not in SCHEMES:
        prefixes = ", ".join(f"{supported}://" for supported in SCHEMES)
        raise UsageError(
            f"An address that begins with {scheme}:// is not supported. Give one that begins with {prefixes} or "
            "file://, or a path of the file system."
        )
    path = location.rstrip("/")
    # the path is not quoted in the error, because it may contain a password
    if not _PARTS.fullmatch(path) or ".." in path.split("/"):
        raise UsageError(
            f"An address of a store is {scheme}://BUCKET/FOLDER with letters, digits and ._=+,- only. Credentials belong in "
            f"the environment or in a profile, never in an address."
        )
    if scheme == "az" and "/" not in path:
        raise UsageError(f"{scheme}://{path} names no container. Give az://ACCOUNT/CONTAINER/FOLDER.")
    return BucketAddress(scheme, path)


def settings(address: BucketAddress, environment: Mapping[str, str] = os.environ) -> ClientSettings:
    """Return the client's settings that it does not read from the environment itself.

    These are the settings of a profile, and whether TLS is used. Raises `UsageError` if the selected profile does not
    exist.
    """
    if address.scheme == "az":  # the client expects the account as a setting
        account, _, container_path = address.path.partition("/")
        return ClientSettings({"account_name": account}, url=f"az://{container_path}")
    if address.scheme != "s3":
        return ClientSettings()
    # not every server supports bulk deletion, and objects are deleted one at a time
    client_settings = ClientSettings({"disable_bulk_delete": True})
    profile = environment.get("AWS_PROFILE") or environment.get("AWS_DEFAULT_PROFILE") or ""
    if profile or not any(environment.get(name) for name in _OWN):
        _add_profile(client_settings, profile, environment)
    endpoints = (environment.get(name) for name in ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"))
    endpoint = next(
        (candidate for candidate in endpoints if candidate), str(client_settings.config.get("endpoint", ""))
    )
    if endpoint:
        client_settings.config["endpoint"] = endpoint
    client_settings.plaintext = endpoint.startswith("http://")
    return client_settings


def _add_profile(client_settings: ClientSettings, profile_name: str, environment: Mapping[str, str]) -> None:
    """Add the settings of a profile. As in other tools, credentials in the environment take precedence.

    Raises `UsageError` if the profile does not exist or a file of profiles cannot be read.
    """
    home = Path(environment.get("HOME") or "~").expanduser() / ".aws"
    files = [
        (environment.get("AWS_CONFIG_FILE") or home / "config", "profile "),
        (environment.get("AWS_SHARED_CREDENTIALS_FILE") or home / "credentials", ""),
    ]
    name, exists = profile_name or "default", False
    profile: dict[str, str] = {}
    for path, section_prefix in files:
        reader = configparser.RawConfigParser()
        try:
            reader.read(path, encoding="utf-8")
        except (configparser.Error, UnicodeDecodeError):  # not quoted, because the text could contain a credential
            raise UsageError(f"{path} is not a file of profiles: a line of it cannot be read.") from None
        for section in (name, f"{section_prefix}{name}"):
            if reader.has_section(section):
                exists = True
                profile.update(reader.items(section))
    if profile_name and not exists:
        raise UsageError(f"There is no profile {profile_name} in {files[1][0]} or {files[0][0]}; AWS_PROFILE names it.")
    client_settings.config.update({new: profile[old] for old, new in _PLAIN.items() if profile.get(old)})
    region = environment.get("AWS_REGION") or environment.get("AWS_DEFAULT_REGION")
    if region:
        client_settings.config["region"] = region
    if any(environment.get(variable) for variable in _OWN):
        return
    if profile.get("aws_secret_access_key"):
        client_settings.config.update({new: profile[old] for old, new in _STATED.items() if profile.get(old)})
    elif exists and any(
        key.startswith(("sso_", "role_arn", "credential_process", "source_profile")) for key in profile
    ):
        client_settings.provider = _provider(name)


def _provider(name: str) -> Any:
    """Return a boto3 provider for the credentials of a profile without its own: a role, or a single sign-on."""
    with extras.explain_missing(f"The profile {name}, whose credentials are those of a role or a sign-on,"):
        from boto3 import Session
        from obstore.auth.boto3 import Boto3CredentialProvider
    return Boto3CredentialProvider(Session(profile_name=name))
