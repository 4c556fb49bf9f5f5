"""Digital twin of an underwater laser triangulation sensor: renders captures with Mitsuba 3."""
