"""Performance of the payload over many passes: trends, change points, requirements over time, monthly reports."""
