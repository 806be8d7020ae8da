# reli3d on a CPU: docker build -t reli3d . && docker run --rm -v "$PWD:/work" reli3d reli3d-infer photos/shoe
FROM python:3.11-slim
ENV PIP_NO_CACHE_DIR=1 PYTHONUNBUFFERED=1 WARP_CACHE_PATH=/opt/reli3d-kernels
COPY . /src
RUN pip install --index-url https://download.pytorch.org/whl/cpu torch==2.13.0 \
    && pip install -c /src/constraints.txt /src \
    && rm -r /src \
    && reli3d-infer --output /tmp/example \
    && rm -r /tmp/example \
    && chmod -R a+rwX "$WARP_CACHE_PATH"
WORKDIR /work
CMD ["reli3d", "--help"]
