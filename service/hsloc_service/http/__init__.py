"""The HTTP side: application, routes, guards, and uvicorn's protocol with time-outs."""
