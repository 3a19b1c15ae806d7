"""``python -m tacpipe``: the same as ``tacpipe``."""

from tacpipe.cli.main import main

if __name__ == "__main__":
    main()
