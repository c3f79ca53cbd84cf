"""This folder holds the static networks that Kinet can stand on, and the interface that a user's own must offer."""
