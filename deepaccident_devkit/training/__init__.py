"""What training reads: resized images that are kept, and datasets and batches for PyTorch."""
