"""NI-DAQmx boards."""
