"""Pictures in and out: video, masks, meshes, and the CPU rasteriser that projects meshes into them."""
