# docker build -t redetect . && docker run --rm -v "$PWD:/data" redetect demo -o demo
FROM python:3.11-slim

# Locked packages of `requirements/lock.txt` would bring the tools of development along: what is installed is what
# `pyproject.toml` allows.
WORKDIR /source
COPY pyproject.toml README.md LICENSE ./
COPY camera camera
COPY detect detect
COPY lut lut
COPY redetect redetect
RUN pip install --no-cache-dir '.[bags,dxf,parquet]'

# Kernels are compiled once, when the image is built; compiled ones and tables stay in the image.
ENV NUMBA_CACHE_DIR=/var/cache/redetect/kernels REDETECT_CACHE=/var/cache/redetect/tables
RUN mkdir -p /var/cache/redetect && redetect demo -o /tmp/demo && rm -r /tmp/demo \
    && chmod -R a+rwX /var/cache/redetect

WORKDIR /data
ENTRYPOINT ["redetect"]
CMD ["--help"]
