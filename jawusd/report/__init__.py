"""The HTML reports of builds and solves, with their verdicts and figures.

Reads `formats` and `evaluator` objects; imports no other stage, and no drawing code outside `style` and `figures`.
"""
