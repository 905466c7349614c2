"""The browser viewer: pose and key a jaw rig, or inspect the footage and poses of a capture and set its picks."""
