"""Colours of pictures and pages; source and target differ for colour-blind readers, too."""

INK, FAINT = "#2b2b2b", "#9a9a9a"
SOURCE, TARGET = "#dd7a2f", "#2c5f8d"
CORRECT, WRONG = "#3f9b6c", "#a3213f"
TRUTH = "#7b6ba8"
