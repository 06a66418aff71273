"""Training the occupancy network: data (`objects`, `dataset`, `batch`), what is minimised (`objective`), the resumable run (`loop`, `record`)."""
