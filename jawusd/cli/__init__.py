"""The command line: typer commands and the text that they print.

Commands import heavy packages inside their functions, so that `jawusd --help` is fast. No other package imports `cli`.
"""
