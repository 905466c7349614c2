"""The method of Yang et al. (2019) as published: energy, renderers, NLPCA model, experiments and figures.

The only layer besides `solvers` that imports torch, and only in `nlpca`. Imported by `pipeline` alone.
"""
