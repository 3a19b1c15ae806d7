"""An environment with Rerun, which is too heavy for the tests' own: ``python -m tests.viewer.environment FOLDER``, 0.5 GB.

All other packages are those of the environment that runs this.
"""

import subprocess
import sys
import sysconfig
import tomllib
import venv
from pathlib import Path

ROOT = Path(__file__).parents[2]
NEEDED = ("attrs", "pillow", "psutil", "typing-extensions")  # Packages that Rerun needs, beyond those of tacpipe.


def make(folder: Path) -> Path:
    """Make the environment in ``folder`` and return its interpreter."""
    venv.create(folder, with_pip=True, clear=True)
    python = folder / "bin" / "python"
    requirements = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]["view"]
    install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    constrained = ["-c", str(ROOT / "constraints.txt")]
    subprocess.run([*install, *constrained, "--no-deps", *requirements], check=True)
    subprocess.run([*install, *constrained, *NEEDED], check=True)
    command = [str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    packages = Path(subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip())
    (packages / "tests.pth").write_text(f"import site; site.addsitedir({sysconfig.get_path('purelib')!r})\n")
    return python


if __name__ == "__main__":
    print(make(Path(sys.argv[1])))
