"""Pictures; matplotlib is loaded only by importing from here."""
