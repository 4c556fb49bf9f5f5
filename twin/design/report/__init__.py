"""Page of a design study: charts, tables, and a drawing of the chosen design to scale."""
