"""Mathematics that knows no camera: frozen arrays, rigid transforms, rays, covariances."""
