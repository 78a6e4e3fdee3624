"""Images of log brightness made of events: accumulated change, solved images, thresholds, sharp frames."""
