# docker build -t densify . && docker run --rm -v "$PWD:/work" densify run --key 120 --window 5
FROM python:3.12-slim
RUN pip install --no-cache-dir 'torch<2.14' --index-url https://download.pytorch.org/whl/cpu
COPY . /source
RUN pip install --no-cache-dir /source && rm -r /source
WORKDIR /work
ENTRYPOINT ["densify"]
CMD ["--help"]
