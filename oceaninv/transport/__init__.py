"""The ladder of light-field models, from closed forms to exact."""
