"""Key points and lines of an image, and matching by descriptors."""
