"""The bench in a browser: a bench process, a stop process and a web server."""
