"""HTML pages: templates, style, figures, numbers as text, and printing to PDF; used by twin, desk and report."""
