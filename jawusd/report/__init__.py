"""HTML reports on builds and solves, with verdicts and figures."""
