"""Read and write the images of a capture: clips by presentation time, masks, overlays, videos.

The only package that may import PyAV; imports `meshes` only to draw overlays.
"""
