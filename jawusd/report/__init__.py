"""HTML reports on builds and solves, with verdicts and figures.

The inputs are objects of `formats` and `evaluator`. This package imports no other stage; only `style` and `figures`
import drawing code.
"""
