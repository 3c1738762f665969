# syntax-free on purpose: any BuildKit builds this without fetching a front end.
# The base must have Python 3.11 or newer as python3, with venv. Releases pin it by digest.
ARG BASE=python:3.13-slim

FROM ${BASE} AS build
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1 PYTHONDONTWRITEBYTECODE=1
WORKDIR /src
RUN python3 -m venv /venv
COPY pyproject.toml requirements.lock README.md LICENSE ./
# What the lock names and the service needs, in a layer of its own: it changes seldom. The secret is for builders behind
# a proxy with a certificate of its own; without it nothing is mounted.
RUN --mount=type=secret,id=ca,target=/etc/ssl/certs/ca-certificates.crt \
    /venv/bin/python -c "import tomllib; p = tomllib.load(open('pyproject.toml', 'rb'))['project']; print('\n'.join(p['dependencies'] + p['optional-dependencies']['serve'] + p['optional-dependencies']['postgresql']))" > /tmp/wanted.txt \
    && /venv/bin/pip install -q -c requirements.lock -r /tmp/wanted.txt setuptools
COPY hsloc hsloc
COPY service service
RUN /venv/bin/pip install -q --no-deps --no-build-isolation . && /venv/bin/python -m compileall -q /venv
# Compile the kernels for this machine and find the fonts, so that the first job is as quick as the others.
COPY recordings/kidnapped.mcap /tmp/
RUN NUMBA_CACHE_DIR=/opt/hsloc/numba MPLCONFIGDIR=/opt/hsloc/matplotlib sh -c '\
    /venv/bin/hsloc replay -q /tmp/kidnapped.mcap --out /tmp/a && /venv/bin/hsloc replay -q /tmp/kidnapped.mcap --mode slam --out /tmp/b'

FROM ${BASE}
RUN useradd --system --uid 10001 --no-create-home --shell /usr/sbin/nologin hsloc && install -d -o 10001 -m 700 /data /store
COPY --from=build /venv /venv
COPY --from=build /opt/hsloc /opt/hsloc
ENV PATH=/venv/bin:$PATH HSLOC_SERVE_DATA=/data PORT=8000 PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 \
    HSLOC_SANDBOX=if-possible \
    NUMBA_CACHE_DIR=/tmp/hsloc/numba MPLCONFIGDIR=/tmp/hsloc/matplotlib
USER 10001
VOLUME /data
EXPOSE 8000
HEALTHCHECK --interval=10s --timeout=3s --start-period=20s --retries=3 \
    CMD ["python3", "-c", "import os, urllib.request; urllib.request.urlopen(f\"http://127.0.0.1:{os.environ['PORT']}/healthz\", timeout=2)"]
# The root file system may be read-only; numba and matplotlib want to write to their caches, so they get copies.
# The first start prints a token, once. `exec`: SIGTERM reaches the server.
CMD ["sh", "-c", "mkdir -p /tmp/hsloc && cp -r /opt/hsloc/. /tmp/hsloc/ && exec hsloc serve --host 0.0.0.0 --port \"$PORT\" --first-token"]
