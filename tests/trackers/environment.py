"""An environment with what is too heavy for the tests' own: TensorBoard, MLflow with its server, Weights & Biases.

``python -m tests.trackers.environment FOLDER`` makes it in some three minutes and 1 GB, next to torch and tacpipe of the
environment that runs this.
"""

import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

NEEDED = ("mlflow>=3.1,<4", "tensorboard>=2.15,<3", "tensorboardX>=2.6,<3", "wandb>=0.19,<1")


def make(folder: Path) -> Path:
    """Make the environment in ``folder`` and return its interpreter."""
    venv.create(folder, with_pip=True, clear=True)
    python = folder / "bin" / "python"
    script = "import sysconfig; print(sysconfig.get_path('purelib'))"
    process = subprocess.run([str(python), "-c", script], capture_output=True, text=True, check=True)
    install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*install, *NEEDED], check=True)
    path_line = f"import site; site.addsitedir({sysconfig.get_path('purelib')!r})\n"
    (Path(process.stdout.strip()) / "tests.pth").write_text(path_line)
    return python


if __name__ == "__main__":
    print(make(Path(sys.argv[1])))
