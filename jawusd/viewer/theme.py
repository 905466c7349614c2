"""How pages look."""

from __future__ import annotations

import viser


def set_theme(gui: viser.GuiApi, dark: bool = False) -> None:
    """Give the controls of a page room, and the page no advertising.

    Args:
        gui: of the page, or of the server for pages that are still to come.
        dark: whether the page is dark.
    """
    gui.configure_theme(control_width="large", show_logo=False, show_share_button=False, dark_mode=dark)
