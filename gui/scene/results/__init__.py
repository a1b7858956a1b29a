"""What comes of a scene while it is edited: drives, predicted field, figures; saving and playing them."""
