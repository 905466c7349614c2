"""Read and write the images of a capture: clips by presentation time, masks, overlays and videos; owner of PyAV."""
