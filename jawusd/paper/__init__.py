"""The method of Yang et al. (2019) as published: energy, renderers, NLPCA model, experiments and figures.

Besides `solvers`, this is the only package that imports torch, and only in `nlpca`. Only `pipeline` imports this
package.
"""
