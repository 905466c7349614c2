"""The browser viewer: see a jaw rig move, drag it, key it.

`session`, `keytrack`, `clip`, `readouts`, `plots` and `decimate` know nothing of the browser; the other modules are the
page, drawn with viser.
"""
