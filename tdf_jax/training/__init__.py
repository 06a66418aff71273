"""Training the network: data (`objects`, `dataset`, `batch`), what is minimised (`objective`), the run (`loop`, `record`)."""
