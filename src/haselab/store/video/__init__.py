"""Videos in and out, exact to the grey level."""
