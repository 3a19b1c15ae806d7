"""Test where credentials come from, and that they appear nowhere else."""

from pathlib import Path
from typing import Any

import pytest

from tacpipe.errors import UsageError
from tacpipe.store import addresses
from tacpipe.store.addresses import BucketAddress
from tests.conftest import Lab
from tests.stores import places
from tests.stores.places import KEY, SECRET

LAB = BucketAddress("s3", "lab/store")


def settings(tmp_path: Path, credentials: str = "", config: str = "", **environment: str) -> dict[str, Any]:
    """Return the settings that two files of profiles and variables give."""
    (tmp_path / "credentials").write_text(credentials)
    (tmp_path / "config").write_text(config)
    files = {"AWS_SHARED_CREDENTIALS_FILE": tmp_path / "credentials", "AWS_CONFIG_FILE": tmp_path / "config"}
    return addresses.settings(LAB, {**{name: str(path) for name, path in files.items()}, **environment}).config


def test_a_profile_gives_credentials_region_and_endpoint(tmp_path: Path) -> None:
    credentials = "[default]\naws_access_key_id = a\naws_secret_access_key = b\n"
    credentials += "[rig]\naws_access_key_id = c\naws_secret_access_key = d\naws_session_token = e\n"
    config = "[profile rig]\nregion = eu-central-1\nendpoint_url = https://s3.lab\n"
    options = settings(tmp_path, credentials, config)
    assert (options["access_key_id"], options["secret_access_key"]) == ("a", "b") and "endpoint" not in options
    options = settings(tmp_path, credentials, config, AWS_PROFILE="rig")
    assert (options["access_key_id"], options["secret_access_key"], options["session_token"]) == ("c", "d", "e")
    assert (options["region"], options["endpoint"]) == ("eu-central-1", "https://s3.lab")


def test_credentials_of_the_environment_come_before_those_of_a_profile(tmp_path: Path) -> None:
    credentials = "[rig]\naws_access_key_id = c\naws_secret_access_key = d\nregion = us-west-1\n"
    options = settings(tmp_path, credentials, AWS_PROFILE="rig", AWS_ACCESS_KEY_ID="x", AWS_REGION="eu-west-1")
    assert "access_key_id" not in options and options["region"] == "eu-west-1"


def test_a_profile_that_is_not_there_and_a_file_that_is_none_are_refused_without_showing_it(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="AWS_PROFILE"):
        settings(tmp_path, AWS_PROFILE="rig")
    with pytest.raises(UsageError) as refused:
        settings(tmp_path, f"aws_secret_access_key = {SECRET}\n")
    assert SECRET not in str(refused.value) and str(tmp_path) in str(refused.value)


@pytest.mark.parametrize(
    "address",
    [f"s3://{KEY}:{SECRET}@lab/store", f"s3://lab/store?X-Amz-Signature={SECRET}", "s3://", "s3://lab/../x", "http://lab/x",
     "az://lab", "memory:///", "s3://lab//x", "file://lab/x"],
)  # fmt: skip
def test_addresses_with_credentials_or_of_other_forms_are_refused_without_showing_them(address: str) -> None:
    with pytest.raises(UsageError) as refused:
        addresses.parse_address(address)
    assert SECRET not in str(refused.value)


def test_plain_http_is_used_only_where_the_endpoint_says_so(tmp_path: Path) -> None:
    for endpoint, plain in (("http://127.0.0.1:9000", True), ("https://s3.lab", False), ("", False)):
        assert addresses.settings(LAB, {"AWS_ENDPOINT_URL": endpoint, "HOME": str(tmp_path)}).plaintext is plain


def test_a_representation_shows_no_credential(tmp_path: Path) -> None:
    (tmp_path / "c").write_text(f"[default]\naws_access_key_id = {KEY}\naws_secret_access_key = {SECRET}\n")
    resolved = addresses.settings(LAB, {"AWS_SHARED_CREDENTIALS_FILE": str(tmp_path / "c"), "HOME": str(tmp_path)})
    assert resolved.config["secret_access_key"] == SECRET and SECRET not in repr(resolved)


def test_no_credential_is_printed_or_written_by_any_command_of_a_store(
    lab: Lab, localbucket: str, impatient: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.run("simulate toy -o data/r --trials 1 --rows 3")
    place = places.bucket("s3://lab/store")
    commands = ["push {} data/r", "push {} data/r --verify", "list --remote {}", "verify --remote {}", "gc --remote {}"]
    commands += ["checkout data/r --remote {} -o back", "pull {} data/r"]
    printed = [lab.run(f"store {command.format(place.address)}") for command in commands]
    printed += [lab.call(f"store push s3://{KEY}:{SECRET}@lab/store data/r")]
    monkeypatch.setenv("AWS_ENDPOINT_URL", "https://127.0.0.1:1")
    monkeypatch.setattr("tacpipe.store.bucket.TRIES", 1)
    printed += [lab.call(f"store push {place.address} data/r")]
    assert [ran.code for ran in printed] == [0] * 7 + [2, 1]
    assert not [ran for ran in printed if SECRET in ran.out + ran.err or KEY in ran.out + ran.err]
    files = [path for folder in (lab.folder, tmp_path / "buckets") for path in folder.rglob("*") if path.is_file()]
    assert len(files) > 20
    assert not [path for path in files if SECRET.encode() in path.read_bytes() or KEY.encode() in path.read_bytes()]


@pytest.mark.long
def test_a_real_server_refuses_a_wrong_secret_and_the_sentence_shows_neither(
    lab: Lab, seaweedfs: str, without_profiles: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = "wrong-but-secret-too"
    for name, value in (places.environment(seaweedfs) | {"AWS_SECRET_ACCESS_KEY": wrong}).items():
        monkeypatch.setenv(name, value)
    lab.run("simulate toy -o data/r --trials 1 --rows 3")
    refused = lab.call("store push s3://lab/store data/r")
    assert refused.code == 1 and "403" in refused.err and refused.err.count("\n") == 1
    assert wrong not in refused.err and KEY not in refused.err and SECRET not in refused.err


def test_the_account_of_an_address_of_azure_is_a_setting_and_the_container_is_the_first_folder() -> None:
    address = addresses.parse_address("az://account/container/touch/store")
    assert isinstance(address, addresses.BucketAddress)
    resolved = addresses.settings(address, {})
    assert (resolved.config["account_name"], resolved.url) == ("account", "az://container/touch/store")
