"""A virtual machine with Debian's stock kernel, whose root is this computer's, read-only: nothing is installed in it."""

import gzip
import lzma
import re
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path

# The machine needs these modules for its root, for HID devices, and for a camera that is none.
MODULES = ("virtio_pci", "9pnet_virtio", "9p", "hid_generic", "uhid", "vivid")
BOOT_S = 300
TRAILER = "TRAILER!!!"
INIT = """#!/bin/busybox sh
/bin/busybox mkdir -p /proc /sys /dev /host
/bin/busybox mount -t proc proc /proc
for module in {modules}; do /bin/busybox insmod /modules/$module.ko; done
/bin/busybox mount -t 9p -o trans=virtio,version=9p2000.L,ro,msize=262144,cache=loose host /host
/bin/busybox mount -t proc proc /host/proc
/bin/busybox mount -t sysfs sys /host/sys
/bin/busybox mount -t devtmpfs dev /host/dev
/bin/busybox chroot /host {command}
/bin/busybox poweroff -f
"""


def lacking() -> str:
    """Return what is missing to run one, nothing if all is there."""
    tools = {"qemu-system-x86_64": "qemu-system-x86", "busybox": "busybox-static", "dpkg-deb": "dpkg"}
    return ", ".join(package for tool, package in tools.items() if shutil.which(tool) is None)


def kernel(cache: Path) -> Path:
    """Return the folder of Debian's kernel package, unpacked, which is fetched if it is not in ``cache``."""
    dependencies = subprocess.run(
        ["apt-cache", "depends", "linux-image-amd64"], capture_output=True, text=True, check=True
    )
    name = re.search(r"Depends: (linux-image-\S+)", dependencies.stdout)
    assert name is not None, "linux-image-amd64 is not in apt's lists; run `apt-get update`"
    folder = cache / name[1]
    if not folder.exists():
        draft = cache / "draft"
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir(parents=True)
        subprocess.run(["apt-get", "download", "-qq", name[1]], cwd=draft, check=True)
        (package,) = draft.glob("*.deb")
        subprocess.run(["dpkg-deb", "-x", package, draft], check=True)
        package.unlink()
        draft.rename(folder)
    return folder


def run(folder: Path, command: str, scratch: Path) -> str:
    """Boot the kernel of ``folder``, run a command in this computer's files, and return what it printed."""
    (image,) = (folder / "boot").glob("vmlinuz-*")
    initrd = scratch / "initrd.gz"
    initrd.write_bytes(gzip.compress(_initrd(folder, command), 1))
    process = subprocess.run(
        [
            *("qemu-system-x86_64", "-accel", "tcg,thread=multi", "-cpu", "max", "-smp", "2", "-m", "768"),
            *("-nographic", "-no-reboot", "-nodefaults", "-serial", "stdio"),
            *("-virtfs", "local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap"),
            *("-kernel", str(image), "-initrd", str(initrd)),
            *("-append", "console=ttyS0 quiet panic=-1"),
        ],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=BOOT_S,
        check=False,
    )
    return process.stdout + process.stderr


def _initrd(folder: Path, command: str) -> bytes:
    files = {path.name.split(".")[0].replace("-", "_"): path for path in folder.rglob("*.ko*")}
    ordered: list[str] = []
    for name in MODULES:
        _with_needs(name, files, ordered)
    init = INIT.format(modules=" ".join(ordered), command=command)
    busybox = Path(shutil.which("busybox") or "busybox").read_bytes()
    return pack(
        [
            ("bin", None),
            ("modules", None),
            ("bin/busybox", busybox),
            ("init", init.encode()),
            *((f"modules/{name}.ko", _module(files[name])) for name in ordered),
        ]
    )


def _with_needs(name: str, files: dict[str, Path], ordered: list[str]) -> None:
    """Append a module to ``ordered``, those that it needs before it; what is no file is in the kernel itself."""
    if name in ordered or name not in files:
        return
    match = re.search(rb"depends=([^\0]*)\0", _module(files[name]))
    for needed in match[1].decode().split(",") if match else ():
        _with_needs(needed.replace("-", "_"), files, ordered)
    ordered.append(name)


def _module(path: Path) -> bytes:
    return lzma.decompress(path.read_bytes()) if path.suffix == ".xz" else path.read_bytes()


def pack(files: Iterable[tuple[str, bytes | None]]) -> bytes:
    """Return a cpio archive (newc, as the kernel unpacks it) of executable files; None stands for a folder."""
    archive = b""
    for number, (name, content) in enumerate([*files, (TRAILER, b"")], start=1):
        mode = 0o040755 if content is None else 0o100755
        data = content or b""
        numbers = (number, mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(name) + 1, 0)
        head = b"070701" + b"".join(b"%08x" % value for value in numbers) + name.encode() + b"\0"
        archive += _fill(head) + _fill(data)
    return archive


def _fill(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)
