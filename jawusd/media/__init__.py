"""Read and write the images of a capture: clips by presentation time, masks, overlays and videos.

Only this package may import PyAV. It imports `meshes` only to draw overlays.
"""
