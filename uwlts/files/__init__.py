"""Files of a running command: safe reading of foreign files, complete writing of outputs, and JSON."""
