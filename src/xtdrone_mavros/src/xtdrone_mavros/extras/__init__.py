"""The plugins of mavros_extras, one module each; ``plugins`` lists them."""
