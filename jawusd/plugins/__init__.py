"""Helpers that run inside other programs; `extension` writes them as files that need nothing of jawusd."""
