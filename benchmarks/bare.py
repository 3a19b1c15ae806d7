"""A program that typer makes of one function: what any command line of this kind costs."""

import sys

import typer

if "--plain" in sys.argv:  # help without rich, as tacpipe prints it
    sys.argv.remove("--plain")
    app = typer.Typer(add_completion=False, rich_markup_mode=None)
else:
    app = typer.Typer(add_completion=False)


@app.command()
def greet(name: str = "world") -> None:
    """Greet someone."""
    print(f"Hello, {name}.")


app()
