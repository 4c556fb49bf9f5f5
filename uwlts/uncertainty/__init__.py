"""How well points and what is measured of them are known."""
