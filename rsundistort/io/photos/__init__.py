"""Photo files of every kind: pixels in the stored frame, and the metadata that travels with them."""
