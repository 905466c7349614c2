"""The HTML reports of builds and solves, with their verdicts and figures.

Its inputs are `formats` and `evaluator` objects. It imports no other stage, and drawing code only in `style` and
`figures`.
"""
