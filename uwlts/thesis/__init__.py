"""Evaluation of recorded campaigns as in G. S. de Matos's thesis (UFSC 2017), compared with its tables."""
