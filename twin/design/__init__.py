"""Design studies: find the sensor to build by formulas, and verify the chosen designs by rendering."""
