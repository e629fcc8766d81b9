"""Other ways to find the same point in another view, made of OpenCV and NumPy alone.

Nothing here imports `closerange`: a peer that shared code with the program would share its
mistakes. Cameras are read by their attributes.
"""
