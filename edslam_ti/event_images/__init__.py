"""Log-brightness images from events: accumulated change, solved images, thresholds, sharp frames."""
