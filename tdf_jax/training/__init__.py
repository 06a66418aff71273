"""Training the occupancy network: data (`data`), what is minimised (`objective`), the resumable loop (`loop`)."""
