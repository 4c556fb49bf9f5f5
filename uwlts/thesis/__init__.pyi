from .thesis_figures import evaluate_thesis as evaluate_thesis
