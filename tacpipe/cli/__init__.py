"""The command line: what is typed, what is printed. Nothing outside this package knows typer."""
