"""The method of Yang et al. (2019) as published: energy, renderers, NLPCA model, experiments and figures."""
