"""The data of training: cached images, and datasets and batches for PyTorch."""
