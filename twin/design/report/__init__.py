"""The page of a design study: charts, the chosen design drawn to scale, tables."""
