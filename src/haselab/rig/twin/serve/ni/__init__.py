"""An emulated NI board behind NI's gRPC device server."""
