"""The jaw in pictures as they come."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from jawusd.cli.options import Allow, Outside, Prim, RigArg
from jawusd.cli.output import say
from jawusd.cli.solve_commands import Head, ShotArg


def live(
    rig: RigArg,
    shot: ShotArg,
    source: Annotated[
        list[str] | None,
        typer.Option(
            help="Where the pictures of a camera come from: NAME=/dev/video0, NAME=rtsp://..., NAME=FILE. Cameras "
            "without one stay out; without any, the shot's videos are played at their own rate.",
            show_default=False,
        ),
    ] = None,
    osc: Annotated[
        str | None, typer.Option(help="HOST:PORT that OSC messages go to: /jaw/d, /jaw/sigma, ...", show_default=False)
    ] = None,
    view: Annotated[bool, typer.Option("--view", help="Show the jaw in a page on this machine, too.")] = False,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; the next free one if taken.")] = 8080,
    head: Annotated[Head, typer.Option(help="fixed: the cameras are worn, and move with the head.")] = Head.free,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after so long.", show_default=False)] = None,
    silence: Annotated[float, typer.Option(min=0.1, help="End when a source sends no picture for so long [s].")] = 10.0,
    jobs: Annotated[int, typer.Option(min=1, max=64, help="Threads that search and follow the teeth.")] = 2,
    allow_outside: Outside = False,
    prim: Prim = None,
    allow: Allow = None,
) -> None:
    """Follow the jaw of the person of a rig in cameras as they run: a line of JSON per instant, OSC, a page.

    Instants that come too fast are left out; every line says how old its pictures are.
    """
    from jawusd.pipeline.live import live as follow
    from jawusd.pipeline.osc import OscSender
    from jawusd.pipeline.view import open_viewer

    sources = dict(_named(entry) for entry in source or [])
    sender = None if osc is None else OscSender(osc)
    viewer = open_viewer(rig, "127.0.0.1", port, prim) if view else None
    if viewer is not None:
        say(f"{viewer.url}  (Ctrl+C stops)", err=True)
    try:
        for found in follow(
            rig,
            shot,
            sources,
            prim=prim,
            fixed_head=head is Head.fixed,
            jobs=jobs,
            seconds=seconds,
            silence_s=silence,
            allow_outside=allow_outside,
        ):
            if sender is not None:
                sender.send(found)
            if viewer is not None:
                viewer.show(found.d)
            say(json.dumps(found.as_json()))
    except KeyboardInterrupt:
        pass
    finally:
        if sender is not None:
            sender.close()
        if viewer is not None:
            viewer.stop()


def _named(entry: str) -> tuple[str, str]:
    name, found, where = entry.partition("=")
    if not found or not name or not where:
        raise typer.BadParameter(f"{entry!r} is not NAME=WHERE, for example mid=/dev/video0.")
    return name, where
