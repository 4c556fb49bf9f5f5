"""Working processes, the terminal, and system libraries: what both packages need to run."""
