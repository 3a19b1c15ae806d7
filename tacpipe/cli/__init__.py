"""Parse command lines and print results. Only this package imports typer."""
