"""The evaluation of G. S. de Matos's thesis (UFSC 2017) on recorded campaigns, its tables beside the measured ones."""
