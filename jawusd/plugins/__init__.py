"""Helpers that run inside other programs; none of them imports jawusd, so that each can be copied there alone."""
