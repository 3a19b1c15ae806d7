"""An environment with the readers that are too heavy for the tests' own: LeRobot's loader, `datasets`, `mlcroissant`.

``python -m tests.exports.environment FOLDER`` makes it in some two minutes and 0.5 GB: what lerobot 0.4.4, the last release
for Python 3.11, needs to read a dataset, next to torch and pandas of the environment that runs this. The whole of lerobot
would be 8 GB. torchvision, of which its loader uses one class for pictures, is replaced by that name. torchcodec decodes
videos, with the shared libraries of Debian's ffmpeg; its later releases need CUDA.
"""

import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

ALONE = (
    "lerobot==0.4.4",
    "accelerate==1.15.0",
    "gymnasium==1.4.0",
    "farama-notifications==0.0.6",
    "torchcodec==0.13.0",
)  # without what they need
NEEDED = (
    *("datasets>=4,<5", "huggingface_hub>=0.34.2,<0.36", "packaging<26", "numpy<2.3", "mlcroissant>=1.0,<2"),
    *("jsonlines", "termcolor", "deepdiff", "einops", "draccus==0.10.0", "av>=15,<16", "cloudpickle"),
)
NO_PICTURES = '''"""Represents torchvision where no dataset has pictures."""


class ToTensor:
    def __call__(self, picture):
        raise NotImplementedError("this environment reads no pictures")


v2 = None
'''


def make(folder: Path) -> Path:
    """Make the environment in ``folder`` and return its interpreter."""
    venv.create(folder, with_pip=True, clear=True)
    python = folder / "bin" / "python"
    result = subprocess.run(
        [str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
        capture_output=True,
        text=True,
        check=True,
    )
    packages = Path(result.stdout.strip())
    (packages / "tests.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*install, "--no-deps", *ALONE], check=True)
    subprocess.run(
        [*install, *NEEDED], check=True, stderr=subprocess.DEVNULL
    )  # pip lists what lerobot needs for pictures
    (packages / "torchvision").mkdir(exist_ok=True)
    (packages / "torchvision" / "__init__.py").write_text('"""Represents torchvision."""\n\n__version__ = "0"\n')
    (packages / "torchvision" / "transforms.py").write_text(NO_PICTURES)
    return python


if __name__ == "__main__":
    print(make(Path(sys.argv[1])))
