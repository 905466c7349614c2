"""The browser viewer: see a jaw rig move, drag it, key it; see a capture's footage with its poses, set its picks.

`session`, `motion`, `readouts`, `plots`, `coverage`, `decimate`, `picks` and `picking_layout` do not depend on viser;
the other modules are the pages and the server.
"""
