"""Add the commands of ``tacpipe store``."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tacpipe.errors import DAMAGED, FAILED, UsageError
from tacpipe.io import terminal
from tacpipe.maintenance import garbage
from tacpipe.maintenance import repair as upkeep
from tacpipe.printable import plain
from tacpipe.store import layout
from tacpipe.store.location import locate
from tacpipe.store.roots import PUSHED
from tacpipe.store.store import Store

if TYPE_CHECKING:
    from tacpipe.maintenance.repair import Soundness
    from tacpipe.store.remote import AnyStore

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Paths = Annotated[list[Path], typer.Argument(help="Datasets.")]
Remote = Annotated[
    str, typer.Argument(metavar="STORE", help="The other store: a directory, or s3://BUCKET/FOLDER, gs://…, az://…")
]
OtherStore = Annotated[
    str | None, typer.Option("--remote", metavar="STORE", help="Other store to read, a directory or an address.")
]
AtRemote = Annotated[
    str | None, typer.Option("--remote", metavar="STORE", help="Other store to work on, a directory or an address.")
]
Replace = Annotated[bool, typer.Option("--replace", help="Replace the content of the directory.")]
Ancestors = Annotated[bool, typer.Option("--ancestors", help="Include the shards of all ancestors.")]


def add(program: typer.Typer, summary: str) -> None:
    """Add the group ``store`` to ``program``."""
    group = typer.Typer(help=summary, no_args_is_help=True, rich_markup_mode=None)
    for command in (init, status, list_, checkout, verify, repair, gc, link, push, pull):
        group.command(command.__name__.rstrip("_"))(command)
    program.add_typer(group, name="store")


def init(
    path: Annotated[
        Path | None, typer.Argument(help="Folder of the store; by default .tacpipe in this folder.")
    ] = None,
    shared: Annotated[
        bool, typer.Option("--shared", help="Let the group of the store's folder read and write it.")
    ] = False,
) -> None:
    """Make this folder a project with its own store, or create or share a store.

    Datasets in the folders below use the project's store, unless a project among
    these folders is marked by pyproject.toml, dvc.yaml, params.yaml or .git.

    Example: tacpipe store init

    Example: tacpipe store init --shared data/store
    """
    from tacpipe.maintenance import sharing

    store = Store(Path.cwd() / layout.BESIDE_NAME if path is None else path.absolute())
    store.prepare()
    text = sharing.share(store) if shared else str(store.root)
    if path is None:
        store.write_file(store.root / layout.PROJECT, b"")
        store.sync(store.root / layout.PROJECT)
    terminal.result(text)


def status(as_json: AsJson = False) -> None:
    """Show the location, size and roots of the store.

    For a store in a bucket, also shows its local cache folder.

    Example: tacpipe store status
    """
    from tacpipe.maintenance import status as statuses

    status = statuses.status(locate())
    _print(status, as_json=as_json, text=statuses.status_text(status))


def list_(store: OtherStore = None, as_json: AsJson = False) -> None:
    """List the datasets in the store, including replaced ones.

    Prints the stage, time, number of recordings and labels, and last path of each.

    Example: tacpipe store list
    """
    from tacpipe.maintenance import checkout as checkouts
    from tacpipe.maintenance import transfer
    from tacpipe.store.cached import bucket_or_folder

    listed = checkouts.list_manifests(bucket_or_folder(locate()) if store is None else transfer.remote_store(store))
    value = {"schema_version": 1, "manifests": [asdict(entry) for entry in listed]}
    _print(value, as_json=as_json, text=checkouts.to_text(listed))


def checkout(
    dataset: Annotated[
        str, typer.Argument(help="Digest, its first digits, or last path, as `store list` prints them.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Directory to write.")],
    store: OtherStore = None,
    replace: Replace = False,
    as_json: AsJson = False,
) -> None:
    """Write a stored dataset, with its labels, to a directory.

    Example: tacpipe store checkout 3f2a91c0d4e5 -o data/recordings
    """
    from tacpipe.maintenance import checkout as checkouts
    from tacpipe.maintenance import transfer

    source = None if store is None else transfer.remote_store(store)
    manifest = checkouts.checkout(dataset, output, replace=replace, source=source)
    value = {
        "schema_version": 1,
        "output": str(output),
        "stage": manifest.stage,
        "recordings": len(manifest.recordings),
    }
    _print({**value, "labelled": len(manifest.labels)}, as_json=as_json, text=str(output))


def verify(remote: AtRemote = None, as_json: AsJson = False) -> None:
    """Check every stored object and record for damage.

    Damaged objects are quarantined, except in a bucket. Exits with 4 if an object
    is damaged or missing, and with 1 if the system failed to read one.

    Example: tacpipe store verify --remote s3://lab/store
    """
    from tacpipe.maintenance import transfer

    store = locate() if remote is None else transfer.remote_store(remote)
    soundness = upkeep.verify(store)
    _print(asdict(soundness), as_json=as_json, text=soundness.to_text(changed=isinstance(store, Store)))
    if soundness.damaged or soundness.missing or soundness.lost:
        raise typer.Exit(DAMAGED)
    _exit_if_unread(soundness)


def repair(as_json: AsJson = False) -> None:
    """Recompute stored objects that are damaged or missing.

    Exits with 4 if an object cannot be recomputed.

    Example: tacpipe store repair
    """
    soundness = upkeep.repair(locate())
    _print(asdict(soundness), as_json=as_json, text=soundness.to_text())
    if soundness.lost:
        raise typer.Exit(DAMAGED)
    _exit_if_unread(soundness)


def _exit_if_unread(soundness: Soundness) -> None:
    """Exit with 1 if the system failed to read objects or records, whose state is therefore unknown."""
    if soundness.unread:
        terminal.report_progress(
            f"{len(soundness.unread)} objects or records could not be read: {next(iter(soundness.unread.values()))}"
        )
        raise typer.Exit(FAILED)


def gc(
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only list what would be removed.")] = False,
    recordings: Annotated[bool, typer.Option("--recordings", help="Include recordings that no dataset names.")] = False,
    grace_days: Annotated[
        float, typer.Option("--grace-days", help="Days for which a dataset at an unreachable path is kept.")
    ] = garbage.GRACE_DAYS,
    forget: Annotated[list[str] | None, typer.Option("--forget", help="Pushed or deleted dataset to forget.")] = None,
    remote: AtRemote = None,
    cache: Annotated[
        bool, typer.Option("--cache", help="Remove local copies of objects in the bucket of TACPIPE_STORE.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Remove stored objects that are not needed.

    Objects of datasets, of their ancestors and of running processes are needed.

    Example: tacpipe store gc --dry-run
    """
    from tacpipe.maintenance import cache as caches
    from tacpipe.maintenance import transfer
    from tacpipe.store.cached import bucket_or_folder

    if not 0 <= grace_days < math.inf:  # NaN also fails this check.
        raise UsageError(f"--grace-days is {grace_days:g}; it must be a number of days of 0 or more.")
    store = locate() if remote is None else transfer.remote_store(remote)
    if cache:
        if forget or recordings:
            raise UsageError("--cache removes copies only. Give --forget and --recordings without it.")
        collected = caches.clear(store, dry_run=dry_run)
    else:
        _forget(bucket_or_folder(store), forget or [], dry_run=dry_run)
        collected = garbage.collect(store, dry_run=dry_run, recordings=recordings, grace_days=grace_days)
    verb = "would remove" if dry_run else "removed"
    text = (
        f"{verb} {collected.objects} objects ({collected.bytes / 1e6:.1f} MB), {collected.records} records, "
        f"{collected.drafts} drafts"
    )
    if collected.kept_recordings:
        text += (
            f"; kept {collected.kept_recordings} streams of recordings that nothing names (--recordings removes them)"
        )
    _print(asdict(collected), as_json=as_json, text=text)


def _forget(store: AnyStore, names: list[str], *, dry_run: bool) -> None:
    """Remove the roots of pushed or deleted datasets; with ``dry_run`` only check them.

    Raises `UsageError` if the store keeps no such dataset.
    """
    from tacpipe.maintenance import pushed

    for name in names:
        roots = store.roots.all()
        local = [root for root in roots if root["kind"] != PUSHED and str(root["path"]) == str(Path(name).absolute())]
        for root in local if not dry_run else ():
            store.roots.remove(root)
        if not pushed.forget(store, name, dry_run=dry_run) and not local:
            stored_names = sorted(pushed.label(root, roots) for root in roots)
            raise UsageError(f"{store.place} keeps no dataset {name}; it keeps {', '.join(stored_names) or 'nothing'}.")


def link(datasets: Paths) -> None:
    """Link the shards of datasets next to their manifests.

    This restores the files for programs that read them directly.

    Example: tacpipe store link data/synced
    """
    for path in datasets:
        count = upkeep.link(path)
        terminal.result(f"{path}: {count} linked again")


def push(
    remote: Remote,
    datasets: Paths,
    ancestors: Ancestors = False,
    verify: Annotated[
        bool, typer.Option("--verify", help="Compare the content of existing objects, not only their size.")
    ] = False,
    replace: Annotated[
        bool,
        typer.Option("--replace", help="Push over a dataset of another computer; it stays in the history."),
    ] = False,
    project: Annotated[
        str, typer.Option("--project", metavar="NAME", help="Push as this project of the other store, now and later.")
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Copy datasets to another store as snapshots.

    The snapshots belong to this project; earlier ones stay there.

    Example: tacpipe store push s3://lab/store models/forward data/latents data/split
    """
    from tacpipe.maintenance import transfer

    transferred = transfer.push(remote, datasets, ancestors=ancestors, verify=verify, replace=replace, project=project)
    _print(asdict(transferred), as_json=as_json, text=_describe_transfer("pushed", transferred))


def pull(
    remote: Remote,
    datasets: Annotated[list[Path], typer.Argument(help="Datasets; PROJECT:PATH is that of another project.")],
    ancestors: Ancestors = False,
    replace: Replace = False,
    as_json: AsJson = False,
) -> None:
    """Copy datasets from another store.

    If the manifest of a dataset is in this project, its missing objects are copied. Otherwise the dataset that was
    pushed from that path is written.

    Example: tacpipe store pull /mnt/lab/store models/forward data/latents data/split
    """
    from tacpipe.maintenance import transfer

    transferred = transfer.pull(remote, datasets, ancestors=ancestors, replace=replace)
    _print(asdict(transferred), as_json=as_json, text=_describe_transfer("pulled", transferred))


def _describe_transfer(verb: str, transferred: Any) -> str:
    """Return a sentence on a transfer, such as "pushed A: 3 objects (1.0 MB); 2 were there already"."""
    names = plain(", ".join(transferred.datasets), 1000)
    text = (
        f"{verb} {names}: {transferred.objects} objects ({transferred.bytes / 1e6:.1f} MB); "
        f"{transferred.there} were there already"
    )
    return f"{text}; replaced {transferred.replaced} that were damaged there" if transferred.replaced else text


def _print(value: Any, *, as_json: bool, text: str) -> None:
    terminal.result_json(value) if as_json else terminal.result(text)
