from .report import evaluate_thesis as evaluate_thesis
