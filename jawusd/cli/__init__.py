"""The command line: typer commands and the text that they print.

Commands import heavy packages inside their functions, so that `jawusd --help` stays quick. Nothing imports `cli`.
"""
