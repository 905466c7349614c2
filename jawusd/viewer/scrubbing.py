"""Clicking and dragging in a plot over frames, which moves the page's frame slider."""

from __future__ import annotations


def scrubbed_by_pointer(drawn: str, ends: tuple[float, float], across: tuple[float, float], slider: str) -> str:
    """Return the HTML of a drawn plot in which a click or a drag moves a slider to the frame under the pointer.

    viser tells the server of no click in a plot, so the page does what a visitor's typing in the slider's box does.

    Args:
        drawn: SVG of the plot, one element.
        ends: first and last frame of its axis.
        across: where these lie across the plot, as shares of its width.
        slider: id of the slider in the page.
    """
    low, high = across
    share = f"((event.clientX-r.left)/r.width-{low:.5f})/{high - low:.5f}"
    box = f"document.getElementById('{slider}').parentElement.querySelector('input:not([type=hidden])')"
    script = (
        f"if(event.buttons&1){{const b={box},"
        f"r=this.firstElementChild.getBoundingClientRect(),s=Math.min(1,Math.max(0,{share}));"
        "Object.getOwnPropertyDescriptor(HTMLInputElement.prototype,'value').set.call(b,"
        f"Math.round({ends[0]:g}+s*{ends[1] - ends[0]:g}));"
        "b.dispatchEvent(new Event('input',{bubbles:true}))}"
    )
    style = "padding:0 6px;cursor:col-resize;touch-action:none;user-select:none"
    return f'<div style="{style}" onpointerdown="{script}" onpointermove="{script}">{drawn}</div>'
