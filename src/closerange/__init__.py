"""Close-range 3-D position sensing with two or more ordinary cameras placed anywhere."""
