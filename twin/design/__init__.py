"""Design studies: which sensor to build. Screens designs by formulas and verifies the chosen ones by rendering."""
