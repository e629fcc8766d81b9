"""Image points of several cameras become world points, with covariance."""
