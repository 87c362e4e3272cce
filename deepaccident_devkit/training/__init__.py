"""Training data: cached images, and datasets and batches for PyTorch."""
