"""This folder holds the training of the shape network: settings, rounds of pictures, losses, trainer, curves."""
