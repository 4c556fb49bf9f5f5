"""Worker processes, the terminal, and system libraries, which both packages need to run."""
