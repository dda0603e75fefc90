"""Models as PyTorch modules: `ShapeLayer` maps codes to vertices, with gradients, on any device."""

from shapespace.torch.layer import ShapeLayer

__all__ = ["ShapeLayer"]
