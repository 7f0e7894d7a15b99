"""Serves a folder by HTTP, at a port that the system chooses; says where, and logs each request.

    mirror.py FOLDER
"""
import http.server
import os
import sys

os.chdir(sys.argv[1])
server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), http.server.SimpleHTTPRequestHandler)
print(f"127.0.0.1:{server.server_port} listens", file=sys.stderr, flush=True)
server.serve_forever()
