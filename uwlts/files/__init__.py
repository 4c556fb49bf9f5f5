"""Files of a running command: safe reading of foreign files, outputs that appear whole or not at all, and JSON."""
