"""Results leave: reports, figures, tables."""
