"""Feed-forward photorealistic style transfer of large-scale 3D radiance fields."""

__version__ = "0.1.0"
__all__ = ["__version__"]
