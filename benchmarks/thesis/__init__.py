"""Parts of the page "The thesis, reproduced": each module recomputes one group of figures."""
